"""Method of Jain & Saunier (arXiv 2001.07243) as published."""
