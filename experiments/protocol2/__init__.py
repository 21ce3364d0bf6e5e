"""The protocol sfkd-bench-2."""
