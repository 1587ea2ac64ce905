"""The simulation steps. Each module implements one effect; its compiled loops are beside it."""
