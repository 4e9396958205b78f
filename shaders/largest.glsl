// Largest absolute values of square blocks of BLOCK x BLOCK texels.
//
//     most(block) = max of |value| over the texels of the block
//
// Inputs:  values  any unit; a field of pairs with PAIRS, otherwise one value in each texel
// Outputs: most    unit of the values; one texel for each block
// Border rule: a block that extends beyond the image uses only its texels inside the image.

void kernel(ivec2 block)
{
    ivec2 begin = block * BLOCK;
    ivec2 end = min(begin + BLOCK, textureSize(values, 0));
    most = 0.0;
    for (int row = begin.y; row < end.y; ++row) {
        for (int col = begin.x; col < end.x; ++col) {
            vec4 size = abs(texelFetch(values, ivec2(col, row), 0));
#if PAIRS
            most = max(most, max(max(size.x, size.y), max(size.z, size.w)));
#else
            most = max(most, size.x);
#endif
        }
    }
}
