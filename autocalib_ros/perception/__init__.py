"""Images to observations: the only rooms that track, detect or match."""
