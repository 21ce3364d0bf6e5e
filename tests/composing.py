"""Settings as a command composes them."""

from functools import cache

from hydra import compose, initialize_config_dir

from sfkd_jax.experiment import command, schemas
from sfkd_jax.experiment.run import Run
from sfkd_jax.store import plain


@cache
def _registered():
    """Hydra's schemas, made once a process."""
    schemas.register()


@cache
def composed(*overrides):
    """The configuration before it is checked."""
    _registered()
    with initialize_config_dir(command.conf_path(), version_base="1.3"):
        return compose("config", overrides=list(overrides))


def settings(*overrides):
    """The checked settings."""
    return command.settings_of(composed(*overrides), overrides)


def run(*overrides):
    """The run of the checked settings, as a command gets it."""
    return Run.of(settings(*overrides))


def plain_settings(*overrides):
    """The checked settings as plain values, as results and policies record them."""
    return plain(settings(*overrides))
