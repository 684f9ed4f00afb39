"""Parts of the tests: readings of coarse sensors, and steps that another parameter explains as well."""
