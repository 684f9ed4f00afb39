"""Separation: the parameters of the blocks from the products that stage one follows."""
