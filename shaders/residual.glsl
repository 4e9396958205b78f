// What a level's correction leaves of its load.
//
//     rest = load - (A + W) d where a component moves, 0 elsewhere
//
// Inputs:  displacement      the correction d, pixels; pairs
//          load              what the level is relaxed for; pairs
//          straight, diagonal  stiffness ratios (ratios.glsl)
//          inverse_diagonal  D^-1 of A + W; 0 where a component does not move; pairs
//          springs           the diagonal matrix W, if SPRINGS; pairs
// Outputs: rest              the unit of the load; pairs
// Border rule: cliques that leave the image do not exist; reads are clamped.

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
