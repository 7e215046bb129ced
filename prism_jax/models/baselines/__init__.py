"""Networks to compare with, each written from its paper."""
