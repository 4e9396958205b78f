// Residual of a level.
//
//     rest = load - (A + W) d where a component is free, 0 elsewhere
//
// Inputs:  displacement      correction d, pixels; pairs
//          load              load of the level, unit of A d; pairs; one texel if it is the same at all
//                            pairs
//          lame              elastic prior: Lame parameters of elements (elements.glsl); pairs
//          straight, diagonal  paper's prior: stiffness ratios (ratios.glsl)
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
    ivec2 at = clamped(pair, textureSize(inverse_diagonal, 0));
    vec4 pulls = vec4(force[0], force[1]);
#if SPRINGS
    pulls += texelFetch(springs, at, 0) * vec4(here[1], here[2]);
#endif
    bvec4 moves = greaterThan(texelFetch(inverse_diagonal, at, 0), vec4(0.0));
    rest = mix(vec4(0.0), texelFetch(load, clamped(pair, textureSize(load, 0)), 0) - pulls, moves);
}
