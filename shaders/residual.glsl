// Residual of a level, for the paper's prior.
//
//     rest = load - (A + W) d where a component is free, 0 elsewhere
//
// Inputs:  displacement      correction d, pixels; pairs
//          load              load of the level, unit of A d (pulls.glsl); pairs
//          straight, diagonal  stiffness ratios (ratios.glsl)
//          inverse_diagonal  D^-1 of A + W; 0 where a component is fixed; pairs
//          springs           diagonal matrix W, if SPRINGS; pairs
// Outputs: rest              unit of the load; pairs
// Border rule: cliques that extend beyond the image do not exist; reads are clamped.

void read_row(ivec2 pair, out vec2 row[4])
{
    read_pairs(displacement, pair, row);
}

void kernel(ivec2 pair)
{
    find_forces(pair);
    ivec2 at = clamped(pair, textureSize(load, 0));
    vec4 pulls = vec4(force[0], force[1]);
#if SPRINGS
    pulls += texelFetch(springs, at, 0) * vec4(here[1], here[2]);
#endif
    bvec4 moves = greaterThan(texelFetch(inverse_diagonal, at, 0), vec4(0.0));
    rest = mix(vec4(0.0), texelFetch(load, at, 0) - pulls, moves);
}
