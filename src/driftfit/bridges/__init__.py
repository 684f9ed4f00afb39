"""Bridges to the interfaces of other packages, one module each; a package is imported only by its module."""
