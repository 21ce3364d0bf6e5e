"""Results of sfkd-bench-2 from anyone: one JSON file an entry, and the page of all."""
