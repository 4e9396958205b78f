// A kernel as a compute shader: one invocation per texel, in groups of GROUP_COLS x GROUP_ROWS.
//
// `begin` and `end` are the corners of the window of texels that is run, (cols, rows); `origin` is
// where texel (0, 0) lies in the written textures.
// Border rule: invocations beyond the window do nothing.

layout(local_size_x = GROUP_COLS, local_size_y = GROUP_ROWS) in;

uniform ivec2 origin;
uniform ivec2 begin;
uniform ivec2 end;

vec4 texel(float value) { return vec4(value, 0.0, 0.0, 0.0); }
vec4 texel(vec2 value) { return vec4(value, 0.0, 0.0); }
vec4 texel(vec4 value) { return value; }

void main()
{
    ivec2 at = ivec2(gl_GlobalInvocationID.xy) + begin;
    if (any(greaterThanEqual(at, end))) {
        return;
    }
    kernel(at);
    STORE_OUTPUTS(at + origin)
}
