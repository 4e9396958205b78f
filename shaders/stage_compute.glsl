// Compute shader of a kernel, in work groups of GROUP_COLS x GROUP_ROWS texels.
//
// A kernel for tissue runs on the listed groups, which contain tissue. An invocation computes ROWS
// vertically adjacent texels, and stores only the total of some outputs: their sum or their largest
// value. Other kernels run in a window.
//
// Inputs:  groups      list of groups: (col, row) of each group, in units of groups
//          first_group first row of the list for this dispatch
//          begin, end  corners of the window, (col, row); for tissue, `end` is the end of the grid
//          origin      position of texel (0, 0) in the output textures, (col, row)
// Border rule: texels outside the window or the grid are not stored.

layout(local_size_x = GROUP_COLS, local_size_y = LOCAL_ROWS) in;

uniform ivec2 origin;
uniform ivec2 end;
#if TISSUE
uniform sampler2D groups;
uniform int first_group;
#else
uniform ivec2 begin;
#endif

vec4 texel(float value) { return vec4(value, 0.0, 0.0, 0.0); }
vec4 texel(vec2 value) { return vec4(value, 0.0, 0.0); }
vec4 texel(vec4 value) { return value; }

/// Run the kernel for a texel and store its outputs.
void run(ivec2 at)
{
    kernel(at);
    if (all(lessThan(at, end))) {
        STORE_OUTPUTS(at)
    }
}

void main()
{
    ivec2 local = ivec2(gl_LocalInvocationID.xy);
#if TISSUE
    ivec2 entry = ivec2(gl_WorkGroupID.xy) + ivec2(0, first_group);
    ivec2 group = ivec2(texelFetch(groups, entry, 0).xy);
    ivec2 at = group * ivec2(GROUP_COLS, GROUP_ROWS) + local * ivec2(1, ROWS);
#if CARRIES
    enter(at);
#endif
    RUN_ROWS(at) // unrolled, because loops are slow on a software renderer
    STORE_TOTALS(ivec2(at.x, at.y / ROWS))
#else
    run(begin + ivec2(gl_WorkGroupID.xy) * ivec2(GROUP_COLS, GROUP_ROWS) + local);
#endif
}
