# %% [markdown]
# # log_to_set

# %%
print(1)
