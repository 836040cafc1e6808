"""Tasks: frozen configs, one module per kind of task."""
