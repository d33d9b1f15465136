"""The report: one HTML file that shows a run, or several, in a browser without a network."""
