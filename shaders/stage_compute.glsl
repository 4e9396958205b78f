// A kernel as a compute shader: one invocation per texel, in groups of GROUP_COLS x GROUP_ROWS.
//
// `origin` is where the grid of texels lies in the written textures, `grid` its size and
// `first_row` where the dispatched range of rows begins.
// Border rule: invocations beyond the grid do nothing.

layout(local_size_x = GROUP_COLS, local_size_y = GROUP_ROWS) in;

uniform ivec2 origin;
uniform ivec2 grid;
uniform int first_row;

vec4 texel(float value) { return vec4(value, 0.0, 0.0, 0.0); }
vec4 texel(vec2 value) { return vec4(value, 0.0, 0.0); }
vec4 texel(vec4 value) { return value; }

void main()
{
    ivec2 at = ivec2(gl_GlobalInvocationID.xy) + ivec2(0, first_row);
    if (any(greaterThanEqual(at, grid))) {
        return;
    }
    kernel(at);
    STORE_OUTPUTS(at + origin)
}
