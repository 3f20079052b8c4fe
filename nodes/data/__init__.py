"""Data: recordings and data sets, written and replayed."""
