"""Tasks: dynamics, cost and limits that a planner plans for."""
