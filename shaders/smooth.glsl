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
//          last              previous step, if MOMENTUM; pixels; pairs
//          coarse            correction of the coarser level, pixels; pairs
//          first_scale, scale, momentum  no unit
// Outputs: corrected         correction after the step, pixels; pairs
//          taken             step, if CONTINUES with another step; pixels; pairs
// Border rule: elements and cliques that extend beyond the image do not exist; reads are clamped.
//
// Kernels that read sites beyond the neighbours of a pair, such as kernels for blanket cliques,
// support only START 0; begin.glsl computes their start.

uniform float scale;
uniform float momentum;
#if START == 1
uniform float first_scale;
#endif

// D^-1 and load at the pair of the current row, and of the row below, as far as `read_row` reads them.
vec4 inverses_here;
vec4 inverses_below;
vec4 load_here;
vec4 load_below;

void read_row(ivec2 pair, out vec2 row[4])
{
#if START == 0
    read_pairs(displacement, pair, row);
#else
    vec2 inverses[4];
    vec2 values[4];
    read_pairs(inverse_diagonal, pair, inverses);
    inverses_below = vec4(inverses[1], inverses[2]);
#if START == 1
    read_pairs(load, pair, values);
    load_below = vec4(values[1], values[2]);
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
    inverses_here = inverses_below;
    load_here = load_below;
    find_forces(pair);
    ivec2 at = clamped(pair, textureSize(load, 0));
#if START == 0
    inverses_here = texelFetch(inverse_diagonal, at, 0);
#endif
#if START != 1
    load_here = texelFetch(load, at, 0);
#endif
    vec4 d = vec4(here[1], here[2]);
    vec4 pulls = vec4(force[0], force[1]);
#if SPRINGS
    pulls += texelFetch(springs, at, 0) * d;
#endif
    vec4 step = scale * inverses_here * (load_here - pulls);
#if START == 0
#if MOMENTUM
    step += momentum * texelFetch(last, at, 0);
#endif
#elif START == 1
    step += momentum * d;
#endif
    corrected = d + step;
#if CONTINUES
    taken = step;
#endif
}
