"""The documentation's site: what MkDocs does not do by itself, and what is generated from records."""
