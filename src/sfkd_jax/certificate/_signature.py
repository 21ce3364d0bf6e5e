"""Signatures of certificates, by ed25519 of the package `cryptography` (`[sign]`)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sfkd_jax import store


@dataclass(frozen=True, kw_only=True)
class Signature:
    """Who vouches for a certificate, its measured numbers included.

    Attributes:
        public_key: ed25519 key, in hexadecimal.
        value: signature of the hash of the document, in hexadecimal.
    """

    public_key: str
    value: str


def can_check() -> bool:
    """Return whether `cryptography` is installed."""
    return find_spec("cryptography") is not None


def private_key(key_file: str | Path) -> Any:
    """Return the private ed25519 key in a PEM file without a password.

    Raises:
        ArtefactError: the file holds no such key.
        ValueError: `cryptography` is not installed.
    """
    _need_cryptography()
    from cryptography.hazmat.primitives.asymmetric import ed25519
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    path = Path(key_file)
    key = _load_pem(load_pem_private_key, path, None)
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise store.failure(path, "is no private ed25519 key")
    return key


def sign(digest: str, key_file: str | Path) -> Signature:
    """Return the signature of a hash, see `private_key`.

    Args:
        digest: hash of a document, in hexadecimal.
        key_file: of the private key.
    """
    key = private_key(key_file)
    public = key.public_key().public_bytes_raw().hex()
    return Signature(public_key=public, value=key.sign(bytes.fromhex(digest)).hex())


def is_signed(digest: str, signature: Signature) -> bool:
    """Return whether a signature is that of its key and of this hash."""
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric import ed25519

    try:
        key = bytes.fromhex(signature.public_key)
        value = bytes.fromhex(signature.value)
        ed25519.Ed25519PublicKey.from_public_bytes(key).verify(
            value, bytes.fromhex(digest)
        )
    except (InvalidSignature, ValueError):
        return False
    return True


def describe_signature(digest: str, signature: Signature | None) -> str:
    """Return who signed a hash, in words: "unsigned" or "signed by …"."""
    if signature is None:
        return "unsigned"
    if not can_check():
        # Anybody can write a name.
        return f"signed by {signature.public_key}, which is not checked"
    if not is_signed(digest, signature):
        return f"unsigned: the signature is not that of {signature.public_key}"
    return f"signed by {signature.public_key}"


def public_key_of(signer: str | Path) -> str:
    """Return a public ed25519 key in hexadecimal.

    Args:
        signer: the key itself, 64 hexadecimal digits, or the path of a PEM file.

    Raises:
        ArtefactError: it is neither.
        ValueError: `cryptography` is not installed.
    """
    _need_cryptography()
    from cryptography.hazmat.primitives.asymmetric import ed25519
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    if re.fullmatch(r"[0-9a-fA-F]{64}", str(signer)):
        return str(signer).lower()
    path = Path(signer)
    key = _load_pem(load_pem_public_key, path)
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise store.failure(path, "is no public ed25519 key")
    return key.public_bytes_raw().hex()


def _load_pem(load: Any, path: Path, *arguments: Any) -> Any:
    """Return the key in a PEM file, or raise an ArtefactError."""
    from cryptography.exceptions import UnsupportedAlgorithm

    # TypeError: the key needs a password.
    try:
        return load(store.read_bytes(path), *arguments)
    except (ValueError, TypeError, UnsupportedAlgorithm) as reason:
        raise store.failure(path, f"no key that can be read: {reason}") from None


def _need_cryptography() -> None:
    """Say in one line what is missing."""
    if not can_check():
        raise ValueError(
            "signatures need the package cryptography: pip install 'sfkd-jax[sign]'"
        )
