"""What the commands print: progress, colours, and the summary of a result."""
