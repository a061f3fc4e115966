"""What the filter is told may be wrong."""
