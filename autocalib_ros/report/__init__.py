"""HTML report of a calibration with figures, and its summary texts.

`page` imports matplotlib and jinja2 and takes seconds; `scene` and `text` are cheap to import.
"""
