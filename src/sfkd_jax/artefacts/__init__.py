"""Files: the only room that reads and writes arrays and JSON. Whatever is wrong with a file is told in one line."""

from sfkd_jax.artefacts._arrays import exists as exists
from sfkd_jax.artefacts._arrays import read_arrays as read_arrays
from sfkd_jax.artefacts._arrays import write_arrays as write_arrays
from sfkd_jax.artefacts._content import differences as differences
from sfkd_jax.artefacts._content import flatten as flatten
from sfkd_jax.artefacts._content import sha256 as sha256
from sfkd_jax.artefacts._content import unflatten as unflatten
from sfkd_jax.artefacts._content import versions as versions
from sfkd_jax.artefacts._files import ArtefactError as ArtefactError
from sfkd_jax.artefacts._files import one_line as one_line
from sfkd_jax.artefacts._files import open_regular as open_regular
from sfkd_jax.artefacts._files import read_json as read_json
from sfkd_jax.artefacts._files import understood as understood
from sfkd_jax.artefacts._files import write_bytes as write_bytes
from sfkd_jax.artefacts._files import write_json as write_json
from sfkd_jax.artefacts._files import writing as writing
from sfkd_jax.artefacts._lines import append_jsonl as append_jsonl
from sfkd_jax.artefacts._lines import read_jsonl as read_jsonl
from sfkd_jax.artefacts._lines import truncate_jsonl as truncate_jsonl
from sfkd_jax.artefacts._npz import read_npz as read_npz
