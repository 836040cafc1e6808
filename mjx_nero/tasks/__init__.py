"""Tasks: frozen configs, one module a kind of task."""
