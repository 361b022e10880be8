"""Training of the baseline of Bütepage et al. (2020), as the paper's authors configured it."""
