"""The replay shell: recordings in, files and reports out, and a simulator with known truth."""
