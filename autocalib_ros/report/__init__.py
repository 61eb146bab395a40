"""report.html: one page that a stranger understands. Shared by the shells.

`page` needs matplotlib and jinja2, and seconds; the other modules cost nothing to import.
"""
