"""Separation: the parameters of the blocks from the products of stage one."""
