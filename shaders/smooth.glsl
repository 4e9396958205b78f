// Chebyshev-Jacobi step of a level's smoother.
//
//     taken = scale D^-1 (load - (A + W) d) + momentum last,    corrected = d + taken
//
// START selects the correction d before the step:
//     0  d = `displacement`
//     1  d = last = first_scale D^-1 load, which is the first step from zero; the pass then runs
//        the second step
//     2  d = `displacement`, plus the interpolated correction of the coarser level
//        (interpolation.glsl) where a component is free; the pass runs the first step, with
//        last = 0
//
// Inputs:  displacement      correction, pixels; pairs
//          load              load of the level, pixels times stiffness; pairs
//          lame              elastic prior: Lame parameters of elements (elements.glsl); pairs
//          straight, diagonal  paper's prior: stiffness ratios (ratios.glsl)
//          inverse_diagonal  D^-1 of A + W; 0 where a component is fixed; pairs
//          springs           diagonal matrix W, if SPRINGS; pairs
//          last              previous step, pixels; pairs
//          coarse            correction of the coarser level, pixels; pairs
//          first_scale, scale, momentum  no unit
// Outputs: corrected         correction after the step, pixels; pairs
//          taken             step, pixels; pairs
// Border rule: elements and cliques that extend beyond the image do not exist; reads are clamped.
//
// Kernels that read sites beyond the neighbours of a pair, such as kernels for blanket cliques,
// support only START 0; begin.glsl computes their start.

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
