"""From options to artefacts: settings, stages, run directories, comparisons."""
