"""The scoreboard: accuracy and speed beside peers and beside what cannot be beaten: ``python -m lab bench``.

Peers are the packages of the extra ``peers``; one that is not installed is left out and named.
"""
