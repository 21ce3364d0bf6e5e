"""How well plans, laws and corridors do."""
