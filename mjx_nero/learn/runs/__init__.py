"""What a training run is, its loop, and everything that it leaves in its folder."""
