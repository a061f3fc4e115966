"""The numbers of the README and of docs/, from the files in runs/reference/: a module for each subject."""
