"""Objects that are models of a library: which, and in which pose; a leaf that only
`Completer` and the commands use, where a library is given."""
