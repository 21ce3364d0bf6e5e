"""Texts that every results page shares, from page.toml."""

from __future__ import annotations

from pathlib import Path

from sfkd_jax.reporting.texts import load_texts

text = load_texts(Path(__file__).with_name("page.toml"))
