"""The filter printed as C: for a batch here, and for export."""
