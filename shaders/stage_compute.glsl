// A kernel as a compute shader, in work groups that cover GROUP_COLS x GROUP_ROWS texels.
//
// A kernel that is for tissue is run for the groups in a list, those that have some; of one that
// carries, an invocation does ROWS texels, one below the other. Others are run for a window, `begin`
// and `end` being its corners, (cols, rows). `origin` is where texel (0, 0) lies in the written
// textures.
//
// Inputs:  groups  the places of the groups to run, (col, row), counted in groups
//          first   the row of that list which the dispatch begins with
// Border rule: nothing is stored beyond `end`, the window's or the grid's.

layout(local_size_x = GROUP_COLS, local_size_y = LOCAL_ROWS) in;

uniform ivec2 origin;
uniform ivec2 end;
#if TISSUE
uniform sampler2D groups;
uniform int first;
#else
uniform ivec2 begin;
#endif

vec4 texel(float value) { return vec4(value, 0.0, 0.0, 0.0); }
vec4 texel(vec2 value) { return vec4(value, 0.0, 0.0); }
vec4 texel(vec4 value) { return value; }

/// Run the kernel for a texel.
void run(ivec2 at)
{
    kernel(at);
    if (all(lessThan(at, end))) {
        STORE_OUTPUTS(at + origin)
    }
}

void main()
{
    ivec2 local = ivec2(gl_LocalInvocationID.xy);
#if TISSUE
    ivec2 entry = ivec2(gl_WorkGroupID.xy) + ivec2(0, first);
    ivec2 group = ivec2(texelFetch(groups, entry, 0).xy);
    ivec2 at = group * ivec2(GROUP_COLS, GROUP_ROWS) + local * ivec2(1, ROWS);
#if CARRIES
    enter(at);
#endif
    RUN_ROWS(at) // not a loop, which a program that plays the GPU is slow at
#else
    run(begin + ivec2(gl_WorkGroupID.xy) * ivec2(GROUP_COLS, GROUP_ROWS) + local);
#endif
}
