"""A module for each effect of docs/effects.md: its picture, and a survey with the effect."""
