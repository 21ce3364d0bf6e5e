"""Faults, kills, hostile files and mutants."""
