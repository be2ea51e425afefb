"""The leaderboard's page: static files that need no server, no build step and no other host.

=================  ===========================================================================
`build`            writes the page from what `board_data` returns
`scenery`          what a browser needs to draw an environment: geometry, names, units
``templates``      HTML; everything but pictures can be read without JavaScript
``static``         the style sheet and the script
=================  ===========================================================================
"""
