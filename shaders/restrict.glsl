// Restriction of a level's residual to the next coarser level, for the elastic prior.
//
//     coarse_load = P^T rest,    rest = load - (A + W) d where a component is free, 0 elsewhere
//
// with the bilinear interpolation P (interpolation.glsl): coarse site i coincides with fine site
// 2 i, and the neighbouring fine sites have weight 1/2 along each axis.
//
// Inputs:  correction        d on the fine level, pixels; pairs
//          load              load of the fine level, pixels times stiffness; pairs
//          lame              Lame parameters of the fine level's elements (elements.glsl); pairs
//          inverse_diagonal  D^-1; 0 where a component is fixed; pairs
//          springs           diagonal matrix W, if SPRINGS; pairs
// Outputs: coarse_load       load of the coarser level, pixels times stiffness; pairs
// Border rule: outside the image, the residual is 0 and elements are void; reads are clamped.
//
// The two coarse sites 2 J and 2 J + 1 require the residual at the fine sites 4 J - 1 to 4 J + 3 of
// three rows, and therefore the displacement of seven sites in five rows. An invocation may compute
// several vertically adjacent pairs. The fine row between two pairs is computed once and used for
// both pairs.

const int SITES = 5;

vec2 below[SITES + 2];
vec2 carried[SITES];
// Weighted sums over the fine row above, at the two coarse sites.
vec2 half_above[2];

void read_row(ivec2 pair, out vec2 row[SITES + 2])
{
    ivec2 size = textureSize(correction, 0);
    vec4 first = texelFetch(correction, clamped(pair - HORIZONTAL, size), 0);
    vec4 second = texelFetch(correction, clamped(pair, size), 0);
    vec4 third = texelFetch(correction, clamped(pair + HORIZONTAL, size), 0);
    row[0] = first.xy;
    row[1] = first.zw;
    row[2] = second.xy;
    row[3] = second.zw;
    row[4] = third.xy;
    row[5] = third.zw;
    row[6] = texelFetch(correction, clamped(pair + 2 * HORIZONTAL, size), 0).xy;
}

/// Compute the forces of the elements between two rows of fine sites on both rows.
void pull(ivec2 pair, vec2 up[SITES + 2], vec2 down[SITES + 2], out vec2 upper[SITES], out vec2 lower[SITES])
{
    vec4 first = lame_at(pair - HORIZONTAL);
    vec4 second = lame_at(pair);
    vec4 third = lame_at(pair + HORIZONTAL);
    vec2 other = vec2(0.0);
    for (int k = 0; k < SITES; ++k) {
        upper[k] = lower[k] = vec2(0.0);
    }
    add_element(first.xy, up[0], up[1], down[0], down[1], other, upper[0], other, lower[0]);
    add_element(first.zw, up[1], up[2], down[1], down[2], upper[0], upper[1], lower[0], lower[1]);
    add_element(second.xy, up[2], up[3], down[2], down[3], upper[1], upper[2], lower[1], lower[2]);
    add_element(second.zw, up[3], up[4], down[3], down[4], upper[2], upper[3], lower[2], lower[3]);
    add_element(third.xy, up[4], up[5], down[4], down[5], upper[3], upper[4], lower[3], lower[4]);
    add_element(third.zw, up[5], up[6], down[5], down[6], upper[4], other, lower[4], other);
}

/// Return the residual at a pair of fine sites, given the force and the displacement there.
vec4 left(ivec2 pair, vec4 pulls, vec4 d)
{
    ivec2 size = textureSize(load, 0);
    ivec2 at = clamped(pair, size);
#if SPRINGS
    pulls += texelFetch(springs, at, 0) * d;
#endif
    bvec4 moves = greaterThan(texelFetch(inverse_diagonal, at, 0), vec4(0.0));
    vec4 rest = mix(vec4(0.0), texelFetch(load, at, 0) - pulls, moves);
    return in_image(pair, size) ? rest : vec4(0.0);
}

/// Compute the weighted sums over a row of fine sites; `pair` contains the first coarse site.
void gather(ivec2 pair, out vec2 across[2])
{
    vec2 here[SITES + 2] = below;
    read_row(pair + VERTICAL, below);
    vec2 force[SITES];
    vec2 lower[SITES];
    pull(pair, here, below, force, lower);
    for (int k = 0; k < SITES; ++k) {
        force[k] += carried[k];
    }
    carried = lower;
    vec2 before = left(pair - HORIZONTAL, vec4(vec2(0.0), force[0]), vec4(vec2(0.0), here[1])).zw;
    vec4 first = left(pair, vec4(force[1], force[2]), vec4(here[2], here[3]));
    vec4 second = left(pair + HORIZONTAL, vec4(force[3], force[4]), vec4(here[4], here[5]));
    across[0] = first.xy + 0.5 * (before + first.zw);
    across[1] = second.xy + 0.5 * (first.zw + second.zw);
}

/// Prepare the first pair of coarse sites of an invocation. The stage calls this function once.
void enter(ivec2 pair)
{
    ivec2 fine = 2 * pair - VERTICAL;
    vec2 above[SITES + 2];
    vec2 force[SITES];
    read_row(fine - VERTICAL, above);
    read_row(fine, below);
    pull(fine - VERTICAL, above, below, force, carried);
    gather(fine, half_above);
}

void kernel(ivec2 pair)
{
    ivec2 fine = 2 * pair;
    vec2 middle[2];
    vec2 next[2];
    gather(fine, middle);
    gather(fine + VERTICAL, next);
    coarse_load = vec4(middle[0] + 0.5 * (half_above[0] + next[0]), middle[1] + 0.5 * (half_above[1] + next[1]));
    half_above = next;
}
