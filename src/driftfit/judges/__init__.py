"""The parts of what judges a run: tests of constancy, paired tests, whiteness, excitation, and their distributions."""
