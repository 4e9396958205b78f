// Scalars on the device: textures of one texel, which kernels write and read.
//
//     ratio = above / below; 0 unless both are positive
//
// Inputs:  above, below  scalars, any units
// Border rule: none needed, because there is only one texel.

/// Return above / below; 0 unless both are positive.
float ratio()
{
    vec2 both = vec2(texelFetch(above, ivec2(0), 0).x, texelFetch(below, ivec2(0), 0).x);
    bool positive = both.x > 0.0 && both.y > 0.0;
    return positive ? both.x / (positive ? both.y : 1.0) : 0.0;
}
