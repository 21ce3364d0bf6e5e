"""A run that is known at every moment, and files of it as recorders write them."""

import numpy as np

STATE = ("p_x", "p_y", "yaw", "v")
NAMES = ("t", *STATE, "steering", "acceleration", "friction", "wind")
WHEELBASE = 2.7


def recorded_run(seconds=30.0, period=0.1, phase=0.0):
    """Columns of a run along v = 5 + sin 0.7 t, yaw = 0.9 sin 0.4 t; positions by
    fine quadrature.
    """
    fine = 20
    t = np.arange(round(seconds / period) * fine + 1) * (period / fine)
    speed, yaw = 5 + np.sin(0.7 * t + phase), 0.9 * np.sin(0.4 * t + phase)
    rate = 0.36 * np.cos(0.4 * t + phase)

    def integral(values):
        return np.concatenate(
            [[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * (period / fine))]
        )

    columns = {
        "t": t,
        "p_x": integral(speed * np.cos(yaw)),
        "p_y": integral(speed * np.sin(yaw)),
        "yaw": yaw,
        "v": speed,
    }
    columns |= {
        "steering": np.arctan(WHEELBASE * rate / speed),
        "acceleration": 0.7 * np.cos(0.7 * t + phase),
    }
    columns |= {
        "friction": 0.6 + 0.2 * np.sin(0.1 * t),
        "wind": 4.0 * np.sin(0.5 * t + phase),
    }
    return {name: values[::fine] for name, values in columns.items()}


def write_csv(path, columns, separator=","):
    """The columns as text that gives every number back."""
    rows = zip(*columns.values(), strict=True)
    body = "\n".join(separator.join(f"{value:.17g}" for value in row) for row in rows)
    path.write_text(f"{separator.join(columns)}\n{body}\n")
    return str(path)


def write_npz(path, columns):
    np.savez(path, **columns)
    return str(path)
