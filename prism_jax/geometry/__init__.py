"""Pure functions of arrays: cameras, rendering, neighbours, sampling, transport."""
