"""Training on unlabelled frames of one's own cells: what is asked about a frame."""
