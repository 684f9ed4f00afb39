"""theta given constraints: which half-spaces and planes it is known to be in, and its distribution there."""
