"""The losses of PRISM, Eq. 3-11: pure functions of one cloud that return a scalar."""
