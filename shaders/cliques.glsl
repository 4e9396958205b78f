// The potentials of three sites s - t - u in a line, t in the middle (eqs. 9 to 11):
//
//     V = w . [ (r_u (d_t - d_s) - (d_u - d_t))^2 + (r_s (d_t - d_u) - (d_s - d_t))^2 ]
//
// with r_s = m_t/m_s, r_u = m_t/m_u and w the weight of the line for the (row, col) component.
// As a function of one site's displacement it is a parabola; curvature A and slope b (minus half
// the derivative at the present displacement) of all cliques of a site add up, and the lowest
// point is b / A away from where the site is.
//
// Everything is built from differences of displacement, taken first: the energy of an assembled
// stencil loses whole pixels to cancellation in a large image.
//
// Border rule: a clique that leaves the image or touches void has both ratios 0 (ratios.glsl) and
// counts for nothing, whatever the displacements given for it.

// Weight of each line for the (row, col) component, no unit: `napari_hmrf.priors.line_weights`.
// Those of square pixels are given here, because the compiler leaves out what they make zero.
#if SQUARE
const vec2 weights[4] = vec2[4](vec2(1.0, 0.0), vec2(0.0, 1.0), vec2(1.0), vec2(1.0));
#else
uniform vec2 weights[4];
#endif

/// What the cliques of a site say about it; energy is that of those whose middle it is.
struct Evidence {
    vec2 curvature;
    vec2 slope;
    float energy;
};

/// Add the clique that the site is the middle of; s and u are d_s - d_t and d_u - d_t.
void add_middle(inout Evidence evidence, vec2 weight, vec2 ratio, vec2 s, vec2 u)
{
    float exists = ratio.x > 0.0 ? 1.0 : 0.0;
    vec2 steep = exists + ratio;
    vec2 first = ratio.y * s + u;
    vec2 second = ratio.x * u + s;
    evidence.curvature += weight * (steep.y * steep.y + steep.x * steep.x);
    evidence.slope += weight * (steep.y * first + steep.x * second);
    vec2 energy = weight * exists * (first * first + second * second);
    evidence.energy += energy.x + energy.y;
}

/// Add a clique that the site is an end of: `near` is the site's own d minus that of the middle,
/// `far` that of the other end minus that of the middle; `ratio` is (m_t / m of the site,
/// m_t / m of the other end).
void add_end(inout Evidence evidence, vec2 weight, vec2 ratio, vec2 near, vec2 far)
{
    float exists = ratio.x > 0.0 ? 1.0 : 0.0;
    vec2 counted = weight * exists;
    evidence.curvature += counted * (ratio.y * ratio.y + 1.0);
    evidence.slope -=
        counted * (ratio.y * (ratio.y * near + far) + (ratio.x * far + near));
}

/// The displacements of a site and of the eight sites around it, each row from left to right.
struct Around {
    vec2 above[3];
    vec2 here[3];
    vec2 below[3];
};

/// Read what lies around both sites of a pair.
void look_around(ivec2 pair, out Around first, out Around second)
{
    ivec2 last = textureSize(displacement, 0) - 1;
    ivec2 before = max(pair - 1, 0);
    ivec2 after = min(pair + 1, last);
    vec2 left = texelFetch(displacement, before, 0).zw;
    vec4 both = texelFetch(displacement, ivec2(pair.x, before.y), 0);
    vec2 right = texelFetch(displacement, ivec2(after.x, before.y), 0).xy;
    first.above = vec2[3](left, both.xy, both.zw);
    second.above = vec2[3](both.xy, both.zw, right);
    left = texelFetch(displacement, ivec2(before.x, pair.y), 0).zw;
    both = texelFetch(displacement, pair, 0);
    right = texelFetch(displacement, ivec2(after.x, pair.y), 0).xy;
    first.here = vec2[3](left, both.xy, both.zw);
    second.here = vec2[3](both.xy, both.zw, right);
    left = texelFetch(displacement, ivec2(before.x, after.y), 0).zw;
    both = texelFetch(displacement, ivec2(pair.x, after.y), 0);
    right = texelFetch(displacement, after, 0).xy;
    first.below = vec2[3](left, both.xy, both.zw);
    second.below = vec2[3](both.xy, both.zw, right);
}

/// What the four cliques that a site is the middle of say.
Evidence centred(ivec2 site, Around near)
{
    vec2 d = near.here[1];
    vec4 ratios_0 = texelFetch(straight, site, 0);
    vec4 ratios_1 = texelFetch(diagonal, site, 0);
    Evidence evidence = Evidence(vec2(0.0), vec2(0.0), 0.0);
    add_middle(evidence, weights[0], ratios_0.xy, near.above[1] - d, near.below[1] - d);
    add_middle(evidence, weights[1], ratios_0.zw, near.here[0] - d, near.here[2] - d);
    add_middle(evidence, weights[2], ratios_1.xy, near.above[0] - d, near.below[2] - d);
    add_middle(evidence, weights[3], ratios_1.zw, near.above[2] - d, near.below[0] - d);
    return evidence;
}

/// The observation energy of a site (eqs. 17 and 18); observation is (y, p = K c).
float observed(vec2 displacement, vec4 observation)
{
    vec2 energy = observation.zw * abs(observation.xy - displacement);
    return energy.x + energy.y;
}
