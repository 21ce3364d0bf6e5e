"""The certificate as a tree, and the JSON file that it is written to as it is."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from sfkd_jax import store
from sfkd_jax.certificate import _signature
from sfkd_jax.certificate._measured import Measured
from sfkd_jax.certificate._proof import Proof
from sfkd_jax.certificate._reading import read_as
from sfkd_jax.certificate._signature import Signature
from sfkd_jax.ranges import NonNegative

Json: TypeAlias = dict[str, Any]
"""Values that are only compared with others."""
FORMAT = 2
"""Version of the document; a reader refuses every other one."""
ADDED = {"added": True}
"""Metadata of a field that format 2 did not have at first: of a document without it the
default holds, and it is not written where it has its default.
"""
UNHASHED = ("sha256", "signature")
"""Entries of a document that its hash is not about."""


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """What a certificate is about, and how it was made.

    Attributes:
        policy_sha256: hash of weights and settings of the policy.
        weights_sha256: hash of its weights.
        versions: of the packages that computed it.
        seconds: that the whole certification took [s].
        seconds_proof: that the proof and its attacks took [s]; None without a proof.
        settings: of the certification; None if no command made it.
    """

    policy_sha256: str
    weights_sha256: str
    versions: dict[str, str]
    seconds: NonNegative
    seconds_proof: NonNegative | None = None
    settings: Json | None = None


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """A certificate of a policy; what else is measured of one is added by subclasses.

    Attributes:
        proof: what is proved; `certification.verify` checks it.
        measured: what is measured on data.
        provenance: what it is about, and how it was made.
        sha256: hash of the document that it was read from; "" if of none.
        signature: of the document, or None.
    """

    proof: Proof
    measured: Measured
    provenance: Provenance
    sha256: str = ""
    signature: Signature | None = None


C = TypeVar("C", bound=Certificate)


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A certification that was refused.

    Attributes:
        reason: in one line.
        provenance: what it is about, and how it was made.
    """

    reason: str
    provenance: Provenance


def write(
    path: Path, certificate: Certificate | Refusal, *, signing_key: str | None = None
) -> None:
    """Write a certificate, or the reason of a refusal.

    Args:
        path: of the file.
        certificate: is written as it is. Its signature is kept if nothing has changed.
        signing_key: path of a private ed25519 key in PEM that signs it.

    Raises:
        ArtefactError: the disk refuses, or the file of the key holds none.
        ValueError: the certificate could not be read again; names the entry.
    """
    entries = store.plain(_entries(certificate))
    kept = {name: entries.pop(name, None) for name in UNHASHED}
    # What is claimed comes first, also where a subclass adds to it.
    provenance = entries.pop("provenance")
    document = {
        "format": FORMAT,
        "valid": isinstance(certificate, Certificate),
        **entries,
        "provenance": provenance,
    }
    digest = _hash(document)
    signature = kept["signature"] if kept["sha256"] == digest else None
    if signing_key is not None:
        signature = asdict(_signature.sign(digest, signing_key))
    document = {**document, "sha256": digest, "signature": signature}
    is_valid = isinstance(certificate, Certificate)
    # Here and not after hours, where somebody loads it.
    parse(store.plain(document), type(certificate) if is_valid else Certificate)
    store.write_json(path, document)


def read(path: Path, kind: type[C]) -> C | Refusal:
    """Read a certificate from an untrusted source; nothing in it is proved yet.

    Args:
        path: of the file.
        kind: `Certificate` or a subclass; the document has the entries of this class.

    Raises:
        ArtefactError: it is damaged, of another format, or was changed since it was
            written.
    """
    document = store.read_json(path)
    with store.as_artefact_error(path):
        try:
            return parse(document, kind)
        except ValueError as reason:
            raise store.failure(path, reason) from None


def parse(document: Mapping[str, Any], kind: type[C]) -> C | Refusal:
    """Return the certificate of a document, see `read`.

    Raises:
        ValueError: an entry is missing, unknown, of another type or range, or was
            changed since the document was written; the message names it.
    """
    if document.get("format") != FORMAT or isinstance(document["format"], bool):
        found = f"{document.get('format')!a:.20}"
        raise ValueError(f"is of format {found}, not {FORMAT}: certify again")
    entries = {
        key: value for key, value in document.items() if key not in ("format", "valid")
    }
    hashed = {key: document[key] for key in document if key not in UNHASHED}
    if _hash(hashed) != document.get("sha256"):
        raise ValueError("it was changed since it was written: its sha256 is another")
    # `is True`, because the text "false" or a number must not pass.
    if document.get("valid") is True:
        return read_as(kind, entries)
    refused = {key: entries[key] for key in entries if key not in UNHASHED}
    return read_as(Refusal, refused)


def signature_of(document: Mapping[str, Any]) -> str:
    """Return who signed a document, in words; the document need not be whole."""
    entries = document.get("signature")
    signature = read_as(Signature, entries, "signature") if entries else None
    hashed = {key: document[key] for key in document if key not in UNHASHED}
    return _signature.describe_signature(_hash(hashed), signature)


def _entries(value: Any) -> Any:
    """Return a tree of dataclasses as dictionaries.

    `ADDED` fields are left out at their default: a document from before them is written
    again as it was, with the hash that its signature is about.
    """
    if isinstance(value, dict):
        return {name: _entries(entry) for name, entry in value.items()}
    if isinstance(value, tuple):
        return tuple(map(_entries, value))
    if not is_dataclass(value):
        return value
    entries = {}
    for entry in fields(value):
        part = getattr(value, entry.name)
        if not (entry.metadata == ADDED and part == entry.default):
            entries[entry.name] = _entries(part)
    return entries


def _hash(document: Mapping[str, Any]) -> str:
    """Return the hash of a document, whatever the order of its entries."""
    text = json.dumps(document, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
