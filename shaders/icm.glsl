// One sweep of iterated conditional modes: each site moves to its best displacement, given its
// neighbours (lines 8 and 9 of the algorithm).
//
//     local energy(e) = A/g e (e - 2 g b/A) + p (|y - d - e| - |y - d|)
//
// for a move e, with the damping g. A and b are the curvature and the slope of the site's cliques
// (cliques.glsl): the cliques with the site in the middle, or with BLANKET all cliques that contain
// the site. If STEPS > 0, the move is the best of {0} and {-e, 0, e}^2 for all steps e; the
// first of several equally good moves is used. If STEPS is 0, the site moves to the exact minimum,
// d = y + soft(q - y, g p / 2A), with q = d + g b/A and the soft threshold `soft`.
//
// Inputs:  displacement  d, pixels; pairs
//          straight, diagonal  stiffness ratios (ratios.glsl)
//          weights       weight of each line, no unit (cliques.glsl)
//          observation   (y in pixels, p = K c in energy per pixel)
//          relaxation    g, in (0, 1]
//          steps         e, pixels
// Outputs: moved         new displacement, pixels; pairs
//          share         energy of each pair before the move, pixels squared; the sum is U_total
// Border rule: cliques that extend beyond the image do not exist, and reads are clamped.

uniform float relaxation;
#if STEPS > 0
uniform float steps[STEPS];
#endif

// Smaller displacements are rounded to 0, because denormal numbers are slow on some devices.
const float FLUSH = 1e-18;

/// Return the displacement with the lowest local energy.
vec2 best(vec2 d, vec2 curvature, vec2 slope, vec4 seen)
{
#if STEPS > 0
    vec2 off = seen.xy - d;
    vec2 now = seen.zw * abs(off);
    // The energy is convex, so it decreases in at most one of the two directions.
    vec2 direction = mix(vec2(1.0), vec2(-1.0), lessThan(2.0 * slope + seen.zw * sign(off), vec2(0.0)));
    vec2 twice = 2.0 * direction * slope;
    off *= direction;
    vec2 move = vec2(0.0);
    float least = 0.0;
    for (int k = 0; k < STEPS; ++k) {
        float e = steps[k];
        vec2 change = min(e * (curvature * e - twice) + (seen.zw * abs(off - e) - now), 0.0);
        vec2 taken = mix(vec2(0.0), vec2(e), lessThan(change, vec2(0.0)));
        float both = change.x + change.y;
        move = both < least ? taken : move;
        least = min(both, least);
    }
    return d + direction * move;
#else
    vec2 share = 1.0 / max(curvature, vec2(TINY));
    vec2 reach = 0.5 * share * seen.zw;
    vec2 distance = (d + share * slope) - seen.xy;
    return seen.xy + (distance - min(max(distance, -reach), reach));
#endif
}

void read_row(ivec2 pair, out vec2 row[4])
{
    read_pairs(displacement, pair, row);
}

/// Return the new displacement of a site, and its energy before the move; k is its index in `here`.
vec2 move(ivec2 site, int k, out float energy)
{
    vec2 d = here[k];
    vec4 seen = texelFetch(observation, site, 0);
    Evidence evidence = centred(site, k);
    energy = evidence.energy + observed(d, seen);
#if BLANKET
    add_all_ends(evidence, site, d);
#endif
    vec2 chosen = best(d, evidence.curvature / relaxation, evidence.slope, seen);
    return mix(chosen, vec2(0.0), lessThanEqual(abs(chosen), vec2(FLUSH)));
}

void kernel(ivec2 pair)
{
    look_around(pair);
    ivec2 site = first_of(clamped(pair, textureSize(displacement, 0)));
    vec2 energy;
    moved.xy = move(site, 1, energy.x);
    moved.zw = move(site + HORIZONTAL, 2, energy.y);
    share = energy.x + energy.y;
}
