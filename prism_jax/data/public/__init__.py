"""Public data sets in their published layouts, each a Source of Examples."""
