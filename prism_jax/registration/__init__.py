"""Objects that are known: which model of a library one is, and in which pose."""
