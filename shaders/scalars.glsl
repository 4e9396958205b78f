// Numbers that stay on the device: images of one texel, written by one kernel and read by the next.
//
// A kernel that takes one may read two, `above` and `below`, and take their ratio.
//
// Border rule: none needed, there is one texel.

/// above / below; 0 unless both are positive.
float ratio()
{
    vec2 both = vec2(texelFetch(above, ivec2(0), 0).x, texelFetch(below, ivec2(0), 0).x);
    bool positive = both.x > 0.0 && both.y > 0.0;
    return positive ? both.x / (positive ? both.y : 1.0) : 0.0;
}
