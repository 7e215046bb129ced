"""Reads data: sources of examples, stored shards, recordings, public sets, batches."""
