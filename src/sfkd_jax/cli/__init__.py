"""The command line: composition, schemas, checks of settings, sweeps."""
