// A Chebyshev-Jacobi step of a level's smoother.
//
//     taken = scale D^-1 (load - (A + W) d) + momentum last,    corrected = d + taken
//
// with d what the correction is before it. START says what that is:
//     0  `displacement`
//     1  the first step from zero, first_scale D^-1 load, which is `last` as well: two steps at once
//     2  `displacement` with the coarser level's correction added (interpolation.glsl), where sites
//        move; a first step, so that there is no `last`
//
// Inputs:  displacement      the correction d, pixels; pairs
//          load              what the level is relaxed for, pixels times stiffness; pairs
//          lame              elastic: Lame's parameters of the elements (elements.glsl); pairs
//          straight, diagonal  the paper's: stiffness ratios (ratios.glsl)
//          inverse_diagonal  D^-1 of A + W; 0 where a component does not move; pairs
//          springs           the diagonal matrix W, if SPRINGS; pairs
//          last              the step before, pixels; pairs
//          coarse            the coarser level's correction, pixels; pairs
//          first_scale, scale, momentum  no unit
// Outputs: corrected, taken  pixels; pairs
// Border rule: elements and cliques that leave the image do not exist; reads are clamped.
//
// What looks further than a pair's neighbours, as the paper's prior does in its blanket reading,
// takes START 0 only (begin.glsl).

uniform float scale;
uniform float momentum;
#if START == 1
uniform float first_scale;
#endif

void read_row(ivec2 pair, out vec2 row[4])
{
#if START == 0
    read_pairs(displacement, pair, row);
#else
    vec2 inverses[4];
    vec2 values[4];
    read_pairs(inverse_diagonal, pair, inverses);
#if START == 1
    read_pairs(load, pair, values);
    for (int k = 0; k < 4; ++k) {
        row[k] = first_scale * inverses[k] * values[k];
    }
#else
    read_pairs(displacement, pair, row);
    read_coarse(pair, values);
    for (int k = 0; k < 4; ++k) {
        row[k] += mix(vec2(0.0), values[k], greaterThan(inverses[k], vec2(0.0)));
    }
#endif
#endif
}

void kernel(ivec2 pair)
{
    find_forces(pair);
    ivec2 at = clamped(pair, textureSize(load, 0));
    vec4 d = vec4(here[1], here[2]);
    vec4 pulls = vec4(force[0], force[1]);
#if SPRINGS
    pulls += texelFetch(springs, at, 0) * d;
#endif
    taken = scale * texelFetch(inverse_diagonal, at, 0) * (texelFetch(load, at, 0) - pulls);
#if START == 0
    taken += momentum * texelFetch(last, at, 0);
#elif START == 1
    taken += momentum * d;
#endif
    corrected = d + taken;
}
