"""The statistics behind the verdict: tests of constancy, break dates, noise, paired tests."""
