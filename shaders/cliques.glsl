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

// Weight of each line for the (row, col) component, no unit: `napari_hmrf.solver.priors.line_weights`.
// Those of square pixels are given here, because the compiler leaves out what they make zero.
#if SQUARE
const vec2 weights[4] = vec2[4](vec2(1.0, 0.0), vec2(0.0, 1.0), vec2(1.0), vec2(1.0));
#else
uniform vec2 weights[4];
#endif

const float TINY = 1e-30;

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

// The displacements around a pair: three rows of four sites, the pair being sites 1 and 2 of the
// middle one. An invocation may do several pairs, one below the other; for each after the first it
// has two of the three rows already.
vec2 above[4];
vec2 here[4];
vec2 below[4];

/// Find the displacement of a pair and of the sites before and after it. A kernel defines this.
void read_row(ivec2 pair, out vec2 row[4]);

/// Get ready for an invocation's first pair. The stage does this, once.
void enter(ivec2 pair)
{
    read_row(pair - VERTICAL, here);
    read_row(pair, below);
}

/// Get ready for a pair: the first, or the one below the last.
void look_around(ivec2 pair)
{
    above = here;
    here = below;
    read_row(pair + VERTICAL, below);
}

/// What the four cliques say that a site, number k of the middle row, is the middle of.
Evidence centred(ivec2 site, int k)
{
    vec2 d = here[k];
    vec4 ratios_0 = texelFetch(straight, site, 0);
    vec4 ratios_1 = texelFetch(diagonal, site, 0);
    Evidence evidence = Evidence(vec2(0.0), vec2(0.0), 0.0);
    add_middle(evidence, weights[0], ratios_0.xy, above[k] - d, below[k] - d);
    add_middle(evidence, weights[1], ratios_0.zw, here[k - 1] - d, here[k + 1] - d);
    add_middle(evidence, weights[2], ratios_1.xy, above[k - 1] - d, below[k + 1] - d);
    add_middle(evidence, weights[3], ratios_1.zw, above[k + 1] - d, below[k - 1] - d);
    return evidence;
}

/// The observation energy of a site (eqs. 17 and 18); observation is (y, p = K c).
float observed(vec2 displacement, vec4 observation)
{
    vec2 energy = observation.zw * abs(observation.xy - displacement);
    return energy.x + energy.y;
}
