"""From points and a sensor to what the network reads, and back to the user's frame."""
