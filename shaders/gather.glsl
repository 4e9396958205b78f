// Restriction of a level's residual to the next coarser level, for the paper's prior.
//
//     coarse_load = even P^T rest
//
// with the bilinear interpolation P (interpolation.glsl): coarse site i coincides with fine site
// 2 i, and the neighbouring fine sites have weight 1/2 along each axis. With centred cliques, a
// load is a mean over sites. Therefore, with EVEN, the factor `even` scales a sum over partial
// surroundings to a sum over full surroundings. Without EVEN, the factor is 1.
//
// Inputs:  rest         residual of the fine level, any unit; 0 where a component is fixed; pairs
//          even         factor on the coarse level, no unit; pairs
// Outputs: coarse_load  unit of the residual; pairs
// Border rule: the residual is 0 outside the image.

/// Return the residual at a pair of fine sites.
vec4 left(ivec2 pair)
{
    ivec2 size = textureSize(rest, 0);
    vec4 values = texelFetch(rest, clamped(pair, size), 0);
    return in_image(pair, size) ? values : vec4(0.0);
}

/// Return the weighted sum over a row of fine sites; `pair` contains the first coarse site.
vec4 along(ivec2 pair)
{
    vec2 before = left(pair - HORIZONTAL).zw;
    vec4 first = left(pair);
    vec4 second = left(pair + HORIZONTAL);
    return vec4(
        first.xy + 0.5 * (before + first.zw), second.xy + 0.5 * (first.zw + second.zw));
}

void kernel(ivec2 pair)
{
    ivec2 fine = 2 * pair;
    coarse_load = along(fine) + 0.5 * (along(fine - VERTICAL) + along(fine + VERTICAL));
#if EVEN
    coarse_load *= texelFetch(even, clamped(pair, textureSize(even, 0)), 0);
#endif
}
