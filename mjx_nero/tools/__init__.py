"""What a user starts: one module or folder a command."""
