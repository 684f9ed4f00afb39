"""The scoreboard: accuracy and speed beside peers and beside what cannot be beaten. ``driftfit bench accuracy|speed``.

Peers are the packages of the extra ``peers``; one that is not installed is left out and named.
"""
