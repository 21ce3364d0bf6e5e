"""The files of options state the defaults of the Python signatures."""

import pytest

from sfkd_jax.assembly import CONTROLLER_SETTINGS
from sfkd_jax.experiment import option_files

FILES = option_files.files()
MPPI = """# MPPI.
defaults: [mppi_schema, _self_]
name: mppi
mppi:
  horizon: 7  # short
"""


@pytest.mark.parametrize("path", FILES, ids=lambda path: "/".join(path.parts[-2:]))
def test_a_file_states_every_setting_with_the_default_of_its_signature(path):
    text = path.read_text("utf-8")
    assert option_files.with_defaults(text, FILES[path]) == text, (
        f"{path}: run python -m sfkd_jax.experiment.option_files"
    )


def test_defaults_follow_what_was_chosen_and_a_change_of_theirs_is_undone():
    schema = CONTROLLER_SETTINGS["mppi"]
    text = option_files.with_defaults(MPPI, schema)
    assert text.startswith(MPPI)
    line = "  num_samples: 1500  # default, in [1, inf)\n"
    assert line in text
    assert "  horizon: 20" not in text
    assert option_files.with_defaults(text.replace("1500", "9"), schema) == text
    chosen = text.replace(line, "  num_samples: 9\n")
    assert "  num_samples: 9\n" in option_files.with_defaults(chosen, schema)
    assert line not in option_files.with_defaults(chosen, schema)
