"""Controllers around a controller: shield, adaptation, delay."""
