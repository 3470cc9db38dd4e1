"""Damaged files for every reader: what it makes of them must be a result or one line.

`python -m tests.fuzz png npz --count 10000` tries more of them and prints the table of `docs/reliability.md`.
"""
