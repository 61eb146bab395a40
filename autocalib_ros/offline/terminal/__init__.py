"""Terminal output of the commands: progress, colours, and the summary of a result."""
