"""Run time assurance: a filter of control barrier functions that corrects every unsafe command."""
