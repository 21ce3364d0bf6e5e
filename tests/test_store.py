"""Run directories from which checkpoints cannot be read are refused before training."""

from pathlib import Path

import pytest

from sfkd_jax.pipeline import store

SETTINGS = {name: {} for name in store.IDENTITY} | {
    "model": {"system": "sfkd"},
    "seed": 0,
    "name": "trial",
}


@pytest.mark.parametrize("name", ["[a]", "trial=[1,2]"])
def test_a_path_that_checkpoints_cannot_be_read_from_is_refused_at_once(tmp_path, name):
    with pytest.raises(ValueError, match=r"cannot be read back from a path with \[ \]"):
        store.claim(SETTINGS | {"root": str(tmp_path), "name": name})
    assert list(tmp_path.iterdir()) == []


def test_other_unusual_names_are_claimed(tmp_path):
    settings = SETTINGS | {"root": str(tmp_path), "name": "a=0.1,b=c d"}
    store.claim(settings)
    assert (Path(store.run_directory(settings)) / "settings.json").exists()
