"""From settings to artefacts: the run store and the stages that commands share."""
