"""One evaluation behind the agents' results and the leaderboard: roll-out, conditions, statistics."""
