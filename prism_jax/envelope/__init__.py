"""What a scan and its completion say of the space around: free, taken, or not known.

Not safety-rated; no claim to any standard; people are never predicted.
"""

NOTICE = (
    "Not safety-rated. No conformity with any standard is claimed. People are never "
    "predicted: whatever was not seen may hold one."
)
"""What every output says."""
