"""What every page shares: its frame, and how a template becomes a page."""
