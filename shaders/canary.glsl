// Test kernel with a known result, which detects a device that computes wrong values.
//
//     first  = (3 n, n + col, n - row, 2^20 + n)
//     second = (n / 4, row - col)
//     third  = n / 8 + row col
//
// where n is the number at the mirrored site. All numbers are integers or multiples of 1/8, so all
// operations are exact in float32. The kernel tests a read from another address, arithmetic, three
// outputs and integer coordinates.
//
// Inputs:  numbers  integers below 1000, no unit
// Outputs: first, second, third  no unit
// Border rule: none needed, because the mirrored site is inside the image.

void kernel(ivec2 site)
{
    float n = texelFetch(numbers, textureSize(numbers, 0) - 1 - site, 0).x;
    float row = float(site.y);
    float col = float(site.x);
    first = vec4(3.0 * n, n + col, n - row, 1048576.0 + n);
    second = vec2(0.25 * n, row - col);
    third = 0.125 * n + row * col;
}
