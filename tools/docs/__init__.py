"""The documentation's site: extensions of MkDocs, and pages generated from records."""
