"""The method: inner loop, meta-loss and test-time adaptation."""
