"""What is shown: pages in the browser, sweeps at their own times, viewers of other programs."""
