// What is left of a level's load, handed down to the next coarser level.
//
//     coarse_load = even P^T rest
//
// with P the bilinear interpolation by which the correction will come back: coarse site i lies on
// fine site 2 i and takes a half of what the fine sites beside it have. A load that is a mean over
// sites, as it is in the paper's centred reading, must stay one: with EVEN the factor `even` makes
// the sum over the tissue there is as large as one over tissue everywhere.
//
// Inputs:  rest         on the fine level, any unit; 0 where nothing moves; pairs
//          even         of the coarse level, no unit; pairs
// Outputs: coarse_load  the unit of the rest; pairs
// Border rule: beyond the border nothing is left.

/// What is left at a pair of fine sites.
vec4 left(ivec2 pair)
{
    ivec2 size = textureSize(rest, 0);
    vec4 values = texelFetch(rest, clamped(pair, size), 0);
    return in_image(pair, size) ? values : vec4(0.0);
}

/// The sum along a row of fine sites, at both sites of a coarse pair; `pair` is its first one's.
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
