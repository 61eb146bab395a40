"""The method of Jain and Saunier as published."""
