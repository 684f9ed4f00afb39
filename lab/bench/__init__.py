"""The scoreboard: accuracy and speed, compared with peers and with lower bounds: ``python -m lab bench``.

Peers are the packages of the extra ``peers``; those that are not installed are left out and listed.
"""
