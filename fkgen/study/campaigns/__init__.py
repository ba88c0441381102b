"""Campaigns: statistics of a filter over any number of trials, on any number of machines."""
