"""Policies on the Hugging Face Hub: pushed, and loaded by their address (`[hub]`)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, runtime_checkable

from sfkd_jax.certificate import Certificate
from sfkd_jax.policy._card import CARD, model_card
from sfkd_jax.policy._certificate import SavedHashes
from sfkd_jax.policy._files import CERTIFICATE, FILES, POLICY_FILE, SYSTEM_FILE
from sfkd_jax.store import ArtefactError, one_line, read_json

SCHEME = "hf://"
"""What the address of a policy on the Hub begins with."""
REPOSITORY = re.compile(r"[\w.-]+/[\w.-]+", re.ASCII)
"""Owner and name of a repository."""
REVISION = re.compile(r"[\w./-]+", re.ASCII)
"""A commit, a branch or a tag."""


@runtime_checkable
class SavedPolicy(Protocol):
    """What can be written to a folder, with its certificate."""

    @property
    def certificate(self) -> Certificate | None:
        """The verified certificate, or None."""
        ...

    def save(self, folder: Path) -> SavedHashes:
        """Write the files that `load` reads."""
        ...


class Shareable:
    """A policy that can be given to others through the Hub."""

    def push(
        self: SavedPolicy,
        repository: str,
        *,
        license: str = "apache-2.0",
        private: bool = False,
    ) -> str:
        """Upload the policy and its certificate to the Hub, with a model card.

        It takes one commit, so that no reader gets a certificate of other weights. What
        an earlier push left of a policy there is replaced. Needs
        `pip install "sfkd-jax[hub]"`, and a token of the Hub (`hf auth login`).

        Args:
            repository: "owner/name"; it is made if it does not exist.
            license: of the weights, by its identifier on the Hub.
            private: whether a new repository is private.

        Returns:
            The address of this version for `load`, "hf://owner/name@commit".

        Raises:
            ArtefactError: the extra is not installed, the name is none, or the Hub
                cannot be reached or refuses.
        """
        address = f"{SCHEME}{repository}"
        _check(address, repository)
        hub = _library(address)
        with TemporaryDirectory() as name:
            folder = Path(name)
            self.save(folder)
            _require_kept_signature(address, self.certificate, folder)
            card = model_card(repr(self), self.certificate, address, license)
            (folder / CARD).write_text(card, "utf-8")
            with _one_line(address):
                return _uploaded(hub, repository, folder, private)


def _uploaded(hub: Any, repository: str, folder: Path, private: bool) -> str:
    """Upload a folder in one commit, and return the address of this commit.

    Args:
        hub: huggingface_hub.
        repository: "owner/name".
        folder: with the files of the policy and its card.
        private: whether a new repository is private.
    """
    api = hub.HfApi(library_name="sfkd_jax")
    api.create_repo(repository, private=private, exist_ok=True)
    written = {file.name: file for file in sorted(folder.iterdir())}
    there = set(api.list_repo_files(repository))
    changes = [hub.CommitOperationAdd(name, file) for name, file in written.items()]
    # A certificate of recorded runs that stayed would be read in place of the new one.
    changes += [
        hub.CommitOperationDelete(name)
        for name in FILES
        if name in there and name not in written
    ]
    made = api.create_commit(
        repository, changes, commit_message="A policy and its certificate"
    )
    return f"{SCHEME}{repository}@{made.oid}"


def located(path: str | Path) -> str | Path:
    """Return a path as it is, and of an address on the Hub the downloaded folder.

    Nothing but `FILES` is downloaded. A version that was downloaded before is read from
    the cache of the Hub, which is all there is without a network.

    Args:
        path: as of `load`.

    Raises:
        ArtefactError: the extra is not installed, the address is none, there is no such
            repository or version, no policy in it, or the Hub cannot be reached and the
            policy was not downloaded before.
    """
    address = str(path)
    if not address.startswith(SCHEME):
        return path
    repository, _, revision = address.removeprefix(SCHEME).partition("@")
    _check(address, repository, revision if "@" in address else "main")
    hub = _library(address)
    with _one_line(address):
        folder = hub.snapshot_download(
            repository, revision=revision or None, allow_patterns=list(FILES)
        )
    if not any((Path(folder) / name).is_file() for name in (POLICY_FILE, SYSTEM_FILE)):
        raise ArtefactError(f"{address}: has no {POLICY_FILE} and no {SYSTEM_FILE}")
    return folder


def _require_kept_signature(
    address: str, certificate: Certificate | None, folder: Path
) -> None:
    """Raise an ArtefactError if saving has dropped the signature of a certificate."""
    if certificate is None or certificate.signature is None:
        return
    if read_json(folder / CERTIFICATE)["signature"] is None:
        raise ArtefactError(
            f"{address}: the certificate was signed for other settings: load the "
            "policy without other ones, or sign it again"
        )


def _check(address: str, repository: str, revision: str = "main") -> None:
    """Raise an ArtefactError unless a name can be one of a repository."""
    if not (REPOSITORY.fullmatch(repository) and REVISION.fullmatch(revision)):
        raise ArtefactError(
            f"{one_line(address)}: a policy on the Hub is {SCHEME}owner/name or "
            f"{SCHEME}owner/name@revision"
        )


def _library(address: str) -> Any:
    """Return huggingface_hub, or raise an ArtefactError about what needs it."""
    try:
        import huggingface_hub  # only where something is on the Hub
    except ModuleNotFoundError as missing:
        raise ArtefactError(
            f'{address}: this needs {missing.name}: pip install "sfkd-jax[hub]"'
        ) from None
    return huggingface_hub


@contextmanager
def _one_line(address: str) -> Iterator[None]:
    """Turn what the Hub says into an ArtefactError about an address."""
    from huggingface_hub import errors

    try:
        yield
    except errors.RevisionNotFoundError:
        reason = "the repository has no such revision"
    except errors.RepositoryNotFoundError:
        reason = "no such repository, or a private one: hf auth login"
    except errors.LocalEntryNotFoundError:
        reason = "the Hub cannot be reached, and it was not downloaded before"
    # Its client of HTTP is another one in other versions, and so are its exceptions.
    except Exception as other:
        lines = str(other).strip().splitlines() or [type(other).__name__]
        raise ArtefactError(f"{address}: {one_line(lines[0])}") from other
    else:
        return
    raise ArtefactError(f"{address}: {reason}")
