"""CommonRoad's cars: training, tuning, the page."""
