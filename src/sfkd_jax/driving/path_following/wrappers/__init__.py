"""Controllers around a controller: gate, adaptation and shield."""
