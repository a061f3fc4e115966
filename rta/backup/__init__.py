"""The way to rest: manoeuvres that keep every limit and end where the spacecraft can stay, and the check of them."""
