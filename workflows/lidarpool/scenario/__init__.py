"""Scenario files: models, template, schema."""
