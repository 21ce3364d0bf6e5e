"""Stages from settings to artefacts, and the store of runs that commands share."""
