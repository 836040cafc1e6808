"""Arms behind their drivers. Each module imports what its bus needs when it connects."""
