"""Run time assurance: a filter of control barrier functions that corrects every unsafe command.

from rta.filter import SafetyFilter

result = SafetyFilter()(state, desired)
"""
