// Potentials of cliques: three sites s - t - u on a line, with t in the middle (eqs. 9 to 11).
//
//     V = w . [ (r_u (d_t - d_s) - (d_u - d_t))^2 + (r_s (d_t - d_u) - (d_s - d_t))^2 ]
//
// with r_s = m_t/m_s, r_u = m_t/m_u and the weight w of the line for the (row, col) component.
// V is a quadratic function of the displacement of each site. For each site, the curvatures A and
// the slopes b of its cliques are added. A is half the second derivative of V, and b is minus half
// the first derivative, at the current displacement. The minimum of the sum is at d + b / A.
//
// Differences between displacements are computed first, because in a large image an assembled
// stencil would lose whole pixels to cancellation.
//
// Inputs:  displacement  d, pixels; pairs (read by the kernel's function `read_row`)
//          straight, diagonal  stiffness ratios, no unit (ratios.glsl)
//          weights       w, no unit
// Border rule: a clique that extends beyond the image or contains void has two ratios of 0
// (ratios.glsl) and never contributes.

// Weight of each line for the (row, col) component: `napari_hmrf.solver.priors.line_weights`. The
// weights of square pixels are constants, so that the compiler removes terms with weight zero.
#if SQUARE
const vec2 weights[4] = vec2[4](vec2(1.0, 0.0), vec2(0.0, 1.0), vec2(1.0), vec2(1.0));
#else
uniform vec2 weights[4];
#endif

const float TINY = 1e-30;

/// Sums over the cliques of a site. The energy includes only cliques with the site in the middle.
struct Evidence {
    vec2 curvature;
    vec2 slope;
    float energy;
};

/// Add a clique with the site in the middle; s and u are d_s - d_t and d_u - d_t.
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

/// Add a clique with the site at an end. `near` is the displacement of the site relative to the
/// middle, and `far` is the displacement of the opposite end relative to the middle. `ratio` is
/// (m_t / m of the site, m_t / m of the opposite end).
void add_end(inout Evidence evidence, vec2 weight, vec2 ratio, vec2 near, vec2 far)
{
    float exists = ratio.x > 0.0 ? 1.0 : 0.0;
    vec2 counted = weight * exists;
    evidence.curvature += counted * (ratio.y * ratio.y + 1.0);
    evidence.slope -=
        counted * (ratio.y * (ratio.y * near + far) + (ratio.x * far + near));
}

// Displacements around a pair: three rows of four sites, with the pair at indices 1 and 2 of the
// middle row. An invocation may compute several vertically adjacent pairs; after the first pair, it
// reads only one new row for each pair.
vec2 above[4];
vec2 here[4];
vec2 below[4];

/// Read the displacement of a pair and its left and right neighbours. The kernel defines this.
void read_row(ivec2 pair, out vec2 row[4]);

/// Prepare the first pair of an invocation. The stage calls this function once.
void enter(ivec2 pair)
{
    read_row(pair - VERTICAL, here);
    read_row(pair, below);
}

/// Read the rows for the first pair, or for the pair below the previous pair.
void look_around(ivec2 pair)
{
    above = here;
    here = below;
    read_row(pair + VERTICAL, below);
}

/// Return the sums over the four cliques with the site in the middle; k is its index in `here`.
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

/// Return the observation energy of a site (eqs. 17 and 18); `observation` is (y, p = K c).
float observed(vec2 displacement, vec4 observation)
{
    vec2 energy = observation.zw * abs(observation.xy - displacement);
    return energy.x + energy.y;
}
