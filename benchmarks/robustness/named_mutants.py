"""What `benchmarks.robustness.mutants` changes, and why some changes are not noticed."""

FILES = {
    "_core": ["test_core_bounds.py", "test_core.py"],
    "_claims": ["test_forgeries.py"],
    "_certificate": ["test_forged_certificates.py"],
    "_calibration": ["test_calibration.py"],
    "_document": ["test_document_arithmetic.py"],
    "_output_metrics": ["test_output_claims.py"],
    "_corridor_claims": ["test_corridor_claims.py"],
    "_fixed_points": ["test_corridor_claims.py", "test_fixed_points.py"],
}
"""Tests of each file of the certification package."""
NAMED = {
    "_core": [
        ("+ rounding\n    return bool(residual", "\n    return bool(residual"),
        ("residual * (1 + MARGIN) + error + lost <", "0.5 * residual + error + lost <"),
        ("error * (1 + MARGIN) + left.size * right.shape[1] * TINY", "0.0"),
        (
            "*witness_matrix(weights, w, bound, vertex, metric))",
            "witness_matrix(weights, w, bound, vertex, metric)[0])",
        ),
        ("inexact = 2 * before + ", "inexact = "),
        ("frobenius(squared) + frobenius(start) + frobenius(matrix)", "0.0"),
        ("    error = 4 * UNIT * size * largest\n", "    error = 0.0\n"),
        (
            "[()] * len(operators), rate, operators, metric)",
            "[()], rate, operators[:1], metric)",
        ),
        (
            "in zip(witnesses, vertices, strict=True)",
            "in list(zip(witnesses, vertices, strict=True))[:1]",
        ),
        ("fits = len(witnesses) == len(vertices) and all(", "fits = all("),
        (" and not is_positive_definite(metric)", " and False"),
    ],
    "_claims": [
        ("for vertex in vertices)", "for vertex in vertices[:1])"),
        (
            'zip(witnesses["joint"], vertices, strict=True)',
            'zip(witnesses["joint"][:1], vertices[:1])',
        ),
        (
            'for part, vertex in zip(witnesses["joint"], vertices, strict=True)',
            'for part, vertex in zip(witnesses["joint"], vertices)',
        ),
        (' and weights.declared.transport == "identity"', ""),
        ("scope_holds = claims.scope == scope", "scope_holds = True"),
        ("claims.kappa == 1.0 if metric is None else claims.kappa >= 1.0", "True"),
        ("claims.beta * claims.kappa**0.5", "claims.beta"),
        ("checks |= _operator_checks(", "_operator_checks("),
    ],
    "_certificate": [
        ("not claims.alpha < 1.0 or ", ""),
        (" or certificate.transport_lipschitz != 1.0", ""),
        (
            "    _require_consistent(certificate, claims, weights)\n    except",
            "    pass\n    except",
        ),
        ("require_claims(claims, weights, certificate.env_box)", "pass"),
    ],
    "_calibration": [
        (
            "conformal_quantile(np.max(calibration.scores / units, axis=1), level)",
            "float(np.quantile(np.max(calibration.scores / units, axis=1), level))",
        ),
        ("held_out.scores <= bounds", "held_out.scores[:, :1] <= bounds[:1]"),
    ],
    "_document": [
        ("    verify(proof, params, model=model, weights=weights)\n", ""),
        ('        _require_tubes(document["tube"], proof, document["d_bar"])\n', ""),
        ('{"d_bar": d_bar, **d_bar["by_scenario"]}', '{"d_bar": d_bar}'),
        (" or not supports(trajectories, level)", ""),
        ("<= REPEATED * np.abs(expected)", "<= REPEATED + REPEATED * np.abs(expected)"),
    ],
    "_output_metrics": [
        (
            "claim.joint, claim.alpha, list(vertices), claim.metric",
            "claim.joint, claim.alpha, list(vertices)",
        ),
        (
            "claim.joint, claim.alpha, list(vertices),",
            "claim.joint[:1], claim.alpha, list(vertices)[:1],",
        ),
        ("is_positive_definite(matrix, error)", "is_positive_definite(matrix)"),
        ("error = rounding + ", "error = "),
        ("name not in OUTPUTS or not may_have_metrics(weights)", "name not in OUTPUTS"),
    ],
    "_corridor_claims": [
        ('expected = bounds["nominal"] + bounds', "expected = bounds"),
        ('{"corridor": corridor, **corridor["by_scenario"]}', '{"corridor": corridor}'),
        (" and supports(drives, level)", ""),
        (
            '    require_fixed_points(corridor["fixed_points"], output, '
            'bounds["for_ever_position"])\n',
            "",
        ),
        (
            "for name in JOINT], axis=0)\n    factor",
            "for name in JOINT[:1]], axis=0)\n    factor",
        ),
    ],
    "_fixed_points": [
        ("measured.road / (1.0 - alpha)", "measured.road"),
        ("planner = law + lipschitz * measured.push / (1.0 - alpha)", "planner = law"),
        ("jump / (1.0 - alpha**steps_between_switches)", "jump"),
        ("for k in range(len(envs))", "for k in range(1)"),
        ("product((-1.0, 1.0), repeat=2)", "product((1.0,), repeat=2)"),
        ("not counted or not all(", "not all("),
        (' in ("corridor_m", "after_switch_m"):', ' in ("corridor_m",):'),
    ],
}
"""Mistakes that no single operator makes: text of the file -> its replacement.

Every text occurs once in its file, and the tests notice every one of these mutants.
"""
ARGUED = {
    "what passes is refused by the comparison beside it, or by the core": (
        *("<= error != np.inf", "< bound != np.inf", "<= condition != np.inf"),
        *("<= value != math.inf", "< value != math.inf", "<= size != math.inf"),
        "exact = -1 <= inside",
        # The rest contains the entry that is not finite.
        *("largest <= np.inf and", "largest != np.inf and"),
        "zip(witnesses, vertices, strict=False)",
        # With a metric P the core proves no κ ≤ 1.
        *("claims.kappa != 1.0", "claims.kappa > 1.0", "claims.kappa >= 0.0"),
        # No number of trajectories supports such a level.
        *("< level != 1", "< level <= 1", "< level < 2"),
    ),
    "norms and scores are never negative: ≠ 0 is > 0": (
        "SMALLEST != 0",
        "largest != 0",
        "quantiles != 0",
    ),
    "the same value by another operator": (
        *("type(number) == int", "perturbation / jnp.asarray([*product((-1.0, 1.0)"),
        "latents[:, 2]",  # jax takes the last entry
    ),
    "the same norm by the other of two formulas": (
        *("1e-140 == size", "size == 1e140", "1e-140 <= size", "size <= 1e140"),
        "if 1.0 < size",
    ),
    "the only entry of a list, one of several alike, or the first of two words": (
        *('witnesses["joint"][ -1]', "weights.operators[ -1]"),
        *("witness[ -1]", "witness[0][ -1]"),
        *('mode <= "joint"', "if name <= JOINT[0]"),
    ),
    "nothing that is proved or measured depends on it": (
        *("np.nextafter(0.0, 2.0)", "initial= -1.0", "largest, limit = 1.0"),
        "zip(reference.scores.T, shares, strict=False)",
        # Sizes of batches, compilation, and one iteration more or less.
        *("CHUNK = ", "-(-count * CHUNK) * CHUNK", "BATCH = "),
        *("def _largest", "def _fixed_points_on_grid("),
        *("fori_loop( 1,", "fori_loop( -1,"),
    ),
}
"""Why a change that is not noticed accepts no false claim: reason -> texts of such
changes.
"""
