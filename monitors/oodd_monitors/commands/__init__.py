"""The command that sets the threshold of a recorded score."""
