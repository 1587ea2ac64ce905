"""Pulses of a sensor, and the steps that compute what it measures of each."""
