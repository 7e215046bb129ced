"""Training the released network on unlabelled frames of somebody's own cells.

A plant's recordings have no ground truth. What they have is much that was measured: a
part of it is hidden from the network, which then has to return it.
"""
