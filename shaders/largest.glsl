// Largest values of square blocks of BLOCK x BLOCK texels.
//
//     most(block) = max of values over the texels of the block; at least 0
//
// Inputs:  values  any unit; one value in each texel
// Outputs: most    unit of the values; one texel for each block
// Border rule: a block that extends beyond the image uses only its texels inside the image.

void kernel(ivec2 block)
{
    ivec2 begin = block * BLOCK;
    ivec2 end = min(begin + BLOCK, textureSize(values, 0));
    most = 0.0;
    for (int row = begin.y; row < end.y; ++row) {
        for (int col = begin.x; col < end.x; ++col) {
            most = max(most, texelFetch(values, ivec2(col, row), 0).x);
        }
    }
}
