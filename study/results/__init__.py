"""Programs that renew pages of docs/results from finished studies."""
