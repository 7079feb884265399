"""Compiled operators; each is held against the torch function that it stands for."""

FILE = "tests/ops/test_compiled.py"


def _of(*names: str) -> list[str]:
    return [f"{FILE}::test_{name}" for name in names]


TESTS: dict[str, list[str]] = {
    "ops.csrc.pose": _of("a_pose_from_near_points_agrees_up_to_rounding", "the_reasons_for_no_pose_agree"),
    "ops.csrc.filters": _of(
        "components_are_equal", "filtered_maps_are_equal", "gated_and_merged_maps_agree_up_to_a_root"
    ),
    "ops.csrc.lens": _of("pixels_of_a_lens_are_the_same_bits", "tracks_in_ideal_pixels_are_the_same_bits"),
    "ops.csrc.linear": _of(
        "solutions_of_small_systems_agree_up_to_rounding",
        "a_pose_from_near_points_agrees_up_to_rounding",
        "the_reasons_for_no_pose_agree",
    ),
    "ops.csrc.parallax": _of(
        "triangulated_tracks_agree_up_to_rounding",
        "parallax_of_near_returns_agrees_up_to_rounding",
        "costs_of_depth_profiles_agree_up_to_rounding",
    ),
    "ops.csrc.pyramid": _of("pyramids_agree_up_to_one_rounding"),
    "ops.csrc.search": _of("a_search_for_points_agrees_up_to_rounding"),
    "ops.csrc.sweep": _of(
        "surfaces_and_rivals_are_equal",
        "costs_are_equal_also_where_a_place_lies_behind_the_other_view",
        "places_codes_and_smooth_maps_are_equal",
    ),
    "ops.csrc.tokens": _of("tokens_are_the_same_bits", "whole_depths_in_metres_are_the_same_bits"),
    "ops.csrc.tracks": _of("equations_of_tracks_agree_up_to_rounding", "covariances_of_poses_agree_up_to_rounding"),
    "ops.csrc.windows": _of(
        "numbers_about_windows_agree_textures_up_to_rounding",
        "samples_and_holes_are_the_same_bits",
        "pixels_are_the_same",
    ),
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "ops.csrc.pose": [
        ("outer_root", "return -third - std::copysign(s * size, q);", "return -third + std::copysign(s * size, q);"),
        ("ranges", "d[i][k + 2] = pp * v[i] - s * p[i];", "d[i][k + 2] = pp * v[i] + s * p[i];"),
        ("polish", "y[k] = next - d[k] * m[k];", "y[k] = next + d[k] * m[k];"),
        ("axes", "found[2][i] = third[i];", "found[2][i] = second[i];"),
        ("p3p", "t -= R * X[0][c];", "t += R * X[0][c];"),
        ("take", "from[4 * N + of[k]] - c[1]) / fy", "from[4 * N + of[k]] - c[1]) / fx"),
    ],
    "ops.csrc.filters": [
        ("mark_small", "!row[x - 1] || !across[x - 1]", "!row[x - 1]"),
        ("mark_small", "runs[b].size += runs[a].size;", ""),
        ("mark_small", "< n_pixels) std", "<= n_pixels) std"),
        ("window_extreme", "2 * radius + 1, rows", "radius + 1, rows"),
        ("halo", "!(goes_on[n] || in_gap(usable, y, x))", "!goes_on[n]"),
        ("halo", "others[n] &= !beside[n]", "others[n] &= 1"),
        ("has_neighbour", "met |= (other > low)", "met |= (other > 0.0f)"),
        ("fattened", "n_far += is_far", "n_far += is_near"),
        ("torn", "return usable[m] && ", "return "),
        ("torn", "step <= 2", "step <= 1"),
        ("unsupported", "block[n + w] |= corner, ", ""),
        ("fill", "open[n] || in_gap(mask, y, x)", "open[n]"),
        ("fit_rim", "noise += sigma[m];", "noise = sigma[m];"),
        ("filter_map", "found.sigma[n] * (at * at)", "found.sigma[n] * at"),
        ("gate_map", "all != GATE_ANSWER ? all : code", "code"),
        ("gate_map", "error > ratio * near[n]", "error > 0.0f"),
        ("gate_map", "overlap < min_overlap || ", ""),
        ("merge_maps", "keep ? kind[n] : SOURCE_NONE", "kind[n]"),
    ],
    "ops.csrc.lens": [
        ("distort", "b = 2.0f * (y * (along + p2) + x * p1);", "b = 2.0f * (y * (along + p1) + x * p2);"),
        ("distort", "radial = radial / denominator;", ""),
        ("newton", "dy = b * left_u + c * left_v;", "dy = c * left_u + b * left_v;"),
        ("Camera", "data<float>(distortion) + distortion.size(1) * k", "data<float>(distortion)"),
        ("carry", "J[i][0] * C[j]", "J[i][1] * C[j]"),
        ("undistort_tracks", "valid)[at + i] && ", "valid)[at + i] || "),
        ("jacobian", "J[1][0] = f[1] * b / f[0]", "J[1][0] = f[0] * b / f[1]"),
    ],
    "ops.csrc.linear": [
        ("factor", "square -= row[k] * row[k]", "square += row[k] * row[k]"),
        ("solve", "sound = sound && std::isfinite", "sound = std::isfinite"),
        ("solve", "(first[i] + rest[i]) * scale[i]", "(first[i] + rest[i]) / scale[i]"),
        ("is_collinear", "xyz[2 * N + n] - sum[2]", "xyz[2 * N + n] + sum[2]"),
        ("add_up", "square < square_limit", "square < 4 * square_limit"),
        ("add_up", "-b * w * f[1]", "-a * w * f[1]"),
        ("whitened_length", "total += x * x;", "total += x;"),
        ("pose_last_step", "enough ? in : use", "use"),
        ("pose_last_step", "0.5 * noise * noise", "0.5 * noise"),
        ("solve_spd", "data<double>(b) + n * columns * k", "data<double>(b)"),
    ],
    "ops.csrc.parallax": [
        ("Point", "t1 * a2) * of.stretch", "t1 * a2)"),
        ("triangulate", "p.gy * p.Y - p.py * p.Z;", "p.gx * p.Y - p.py * p.Z;"),
        ("depth_variance", "2 * g0 * g1 * C[1]", "g0 * g1 * C[1]"),
        ("depth_variance", "data<float>(cov_pose) + K * K * k", "data<float>(cov_pose)"),
        ("near_parallax", "off * off + shared", "off + shared"),
        ("near_parallax", "if (tracked && !returned)", "if (!returned)"),
        ("near_parallax", "turn[1] - turn[2] * along", "turn[1] + turn[2] * along"),
        ("triangulate", "data<float>(c_0) + 2 * k, data<float>(f_1)", "data<float>(c_0), data<float>(f_1)"),
        ("add_costs", "rel[n + i] * (moved * moved)", "rel[n + i] * moved"),
        ("profile_cost", "scale = fitted > 0 ? fitted : scale;", "scale = fitted;"),
    ],
    "ops.csrc.pyramid": [
        ("grey", "luma(unit(r[x]), unit(g[x]), unit(b[x]))", "luma(unit(b[x]), unit(g[x]), unit(r[x]))"),
        ("half", "below.row(0, below.pad + 2 * y + k - 2)", "below.row(0, below.pad + 2 * y + k - 1)"),
        ("mirror_sides", "right[k] = right[-k];", "right[k] = right[0];"),
        ("gradients", "g_x[pad + x] = across[x + 2] - across[x];", "g_x[pad + x] = across[x] - across[x + 2];"),
        ("gradients", "slope[x] = under[x] - above[x];", "slope[x] = here[x] - above[x];"),
        ("pyramid_level", "data<uint8_t>(source) + b * one", "data<uint8_t>(source)"),
    ],
    "ops.csrc.search": [
        ("invert", "static_cast<float>(-b / det)", "static_cast<float>(b / det)"),
        ("walk", "p[1] -= step[1];", "p[1] += step[1];"),
        ("walk", "step[1] = found[1] / gain;", "step[1] = found[1];"),
        ("interpolate_border", "(1.0f - std::abs(p[1] - static_cast<float>(i)))", "1.0f"),
        ("interpolate", "left = 1.0f - right", "left = 1.0f"),
        ("interpolate", "ensure_four(row, column)", "ensure_four(column, row)"),
        ("put", "inverse[1] * a + inverse[2] * b", "inverse[1] * a + inverse[0] * b"),
        ("project", "here[k] -= mean[k]", "here[k] -= mean[0]"),
    ],
    "ops.csrc.sweep": [
        ("extend", "std::min(from[0], from[2])", "from[0]"),
        ("choose", "0.5f * (before - after)", "0.5f * (after - before)"),
        ("second_best", "at + reach + 1, D", "at + reach, D"),
        ("second_best", "at - reach, 0", "at - reach + 1, 0"),
        (
            "census_transform",
            "std::fill(to + margin + w, to + wide, row[w - 1]);",
            "std::fill(to + margin + w, to + wide, row[0]);",
        ),
        ("find", "x % 2 == 0 && y % 2 == 0", "x % 2 == 0 || y % 2 == 0 ? x % 2 + y % 2 == 0 && x > 1 : false"),
    ],
    "ops.csrc.tokens": [
        ("depth_code", "std::max(static_cast<float>(raw), 0.0f)", "static_cast<float>(raw)"),
        ("over_unit", "depth_code(raw[k]) / unit", "depth_code(raw[k]) * unit"),
    ],
    "ops.csrc.tracks": [
        ("equations", "H[j * n + i] = *from++", "H[i * n + j] = *from++"),
        ("sums", "weight / (bent * bent)", "weight / bent"),
        ("sums", "W * of_track.J[1][i]", "W * of_track.J[0][i]"),
        ("Jacobian", "J[i][j - 6] * at.height", "J[i][j - 6]"),
        ("pair", "data<T>(x.seen) + 2 * N * k", "data<T>(x.seen)"),
        ("factors", "omega * omega * (spread", "omega * (spread"),
        ("pose_sandwich", "w[i] * w[i] * scatter", "w[i] * scatter"),
        ("pose_sandwich", "data<double>(far_weight)[k]", "data<double>(far_weight)[0]"),
        ("squared_residuals", "data<bool>(front)[N * k + m + i]", "data<bool>(front)[N * k + i]"),
    ],
    "ops.csrc.windows": [
        ("five_extremes", "least < low ? least : low", "least < low ? low : least"),
        ("window_extremes", "*high++ = seen.most;", "*high++ = seen.least;"),
        ("integer_grey", "LUMA_THOUSANDTHS[2] * at[2]", "LUMA_THOUSANDTHS[2] * at[1]"),
        ("smaller", "return middle - (", "return middle + ("),
        ("brightness_of", "least = std::min(least, middle[c]);", "least = std::max(least, middle[c]);"),
    ],
}
